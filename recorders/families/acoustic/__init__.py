"""Records shots and sounds that arrays of microphones hear; begin with `simulator`."""
