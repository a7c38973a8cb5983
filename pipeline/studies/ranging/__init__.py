"""Studies ultra-wideband ranges; begin with `ranging`."""
