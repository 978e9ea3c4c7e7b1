"""What can be said of a fit: profiles, bootstrap, posterior, influence, predictions, design."""
