"""How a force relaxes in time, whatever it is the force of: laws, the filter and its steps."""
