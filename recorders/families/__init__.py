"""Simulators, importers and models of single families of systems, in one package per family.

A family has the same name here, in `fuselog.replay` and in `fuselog.pipeline`. Nothing outside imports
these packages; they register themselves. Begin with a small family, `ranging`.
"""
