"""Checks of estimators against stored replays, field by field; begin with `checking`."""
