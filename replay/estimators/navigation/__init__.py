"""Inertial navigation: its model, its sensors, its alignment; begin with `navigation`."""
