"""Studies and functions shared by all families; begin with `localization`."""
