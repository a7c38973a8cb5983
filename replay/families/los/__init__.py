"""Locates targets by lines of sight, and estimates sensors' biases; begin with `localization`."""
