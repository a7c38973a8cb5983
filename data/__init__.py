"""Shipped experiments, scenarios and small data, found through importlib.resources."""
