"""Presets: everything that a world needs to be trained, evaluated and drawn."""
