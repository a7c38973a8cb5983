"""Studies biometric scores: fusion, and verification in sequence; begin with `study`."""
