"""Files and pictures of a simulation."""
