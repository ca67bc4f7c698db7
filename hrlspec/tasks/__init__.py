"""Tasks: what they pay, and which are trained on."""
