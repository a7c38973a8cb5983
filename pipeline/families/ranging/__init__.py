"""Studies of ultra-wideband ranges; begin with `study`."""
