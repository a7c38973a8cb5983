"""Three trackers of many targets.

Begin with `tracker`, which takes scans from several sensors and associates them by `association`.
`report_tracker` takes single reports, such as those of vessels. `gaussian_mixture_phd` estimates a set
of targets without tracks.
"""
