"""A whole scene: what is there, which effects it calls for, and the program made of them."""
