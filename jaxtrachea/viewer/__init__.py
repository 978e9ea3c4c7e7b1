"""The trachea under the mouse: `jaxtrachea view` and `play.html` (docs/view.md)."""
