"""Tracks many targets; there are three trackers.

Begin with `tracker`, which takes scans of several sensors and associates them by `association`.
`report_tracker` takes reports one by one, such as those of vessels. `gaussian_mixture_phd` estimates a
set of targets without tracks.
"""
