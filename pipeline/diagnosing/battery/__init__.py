"""A benchmark of logs with planted faults: a car with wheels, position fixes and a compass.

Begin with `car`; `battery` counts how often the fault is named first.
"""
