"""Studies inertial units: navigation, outages; begin with `gnss_ins`."""
