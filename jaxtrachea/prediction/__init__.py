"""What a finished fit, read back from its file, predicts: presses, and measured curves."""
