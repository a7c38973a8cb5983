"""Navigation by inertial units: model, sensors, alignment; begin with `navigation`."""
