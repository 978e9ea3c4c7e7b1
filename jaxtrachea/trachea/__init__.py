"""The trachea at rest: geometry, material, mesh and centreline."""
