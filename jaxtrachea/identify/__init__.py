"""From measurements to parameters and what can be said of them."""
