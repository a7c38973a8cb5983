"""Input files of programs that read a log, and the files that they write.

Begin with `estimates`.
"""
