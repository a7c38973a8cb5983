"""Describes how states move and are measured, and estimates any such state by any method."""
