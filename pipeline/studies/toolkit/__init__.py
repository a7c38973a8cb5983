"""Holds what studies of any family share; begin with `localization`."""
