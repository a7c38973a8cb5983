"""Studies inertial units: navigation, outages, orientation; begin with `gnss_ins`."""
