"""Locates shooters and sources of sound by arrival times; begin with `localization`."""
