"""What programs that read a log are given, and what they write.

Begin with `estimates`.
"""
