"""Inference from a fit: profiles, bootstrap, posterior, influence, cross-validation, design."""
