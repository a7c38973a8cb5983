"""Three trackers of many targets.

Begin with `tracker`, which processes scans from several sensors and associates detections by
`association`. `report_tracker` processes single reports, such as those of vessels.
`gaussian_mixture_phd` estimates a set of targets without tracks.
"""
