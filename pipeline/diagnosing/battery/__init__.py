"""Makes logs with one fault planted, as new users have them: a car with wheels, fixes, a compass.

Begin with `car`; `study` counts how often the fault is named first.
"""
