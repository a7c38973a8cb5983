"""The one exception for what a user can mend."""


class BadInput(Exception):
    """Input that no run can use: one sentence with the file, topic, field or option, and the mend.

    The command line prints the sentence and exits with 2; it never shows a traceback for it.
    """
