"""Studies of inertial navigation during GNSS outages; begin with `gnss_ins`."""
