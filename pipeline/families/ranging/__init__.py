"""Studies ultra-wideband ranges; begin with `study`."""
