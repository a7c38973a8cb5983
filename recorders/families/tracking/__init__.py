"""Recorders of many targets: crossing targets, vessel reports, ferries; begin with `crossing`."""
