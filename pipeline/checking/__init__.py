"""Checking: estimators against stored replays, field by field."""
