"""Signed distance, contact points and normal of two convex shapes, with derivatives."""
