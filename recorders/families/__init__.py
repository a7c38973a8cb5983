"""Simulates, imports and models what single families of systems need; a package each.

A family has the same name here, in `fuselog.replay` and in `fuselog.pipeline`. Nothing outside imports
them: they register. Begin with a small one, `ranging`.
"""
