"""What is there at rest: geometry, material."""
