"""What a model is, what it needs of a log, and what may be added to its state.

Begin with `model`.
"""
