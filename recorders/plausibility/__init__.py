"""What a log says of its own faults before any filter: from speeds, courses, forces and stamps alone.

Begin with `checks`: one check is one function, in a table; what they read of a log is a `body`.
"""
