"""What studies of any family share; begin with `localization`."""
