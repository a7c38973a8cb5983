"""Interactive exploration of a filter on a local page whose sliders replay a log as they are dragged.

Begin with `session`, which has a log and its filters, but no server or browser. `page` connects the
session to widgets and plots, and `serving` serves the page to this machine only.
"""
