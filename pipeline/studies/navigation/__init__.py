"""Studies of inertial units: navigation and GNSS outages; begin with `gnss_ins`."""
