"""Importers of real data, one file per source."""
