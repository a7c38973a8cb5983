"""Insertion of braces around the bodies of conditions and loops in C, which templates omit."""

import re

_HEAD = re.compile(r" *(?:\} )?(?:if|for|while|else)\b")
_COMMENT = re.compile(r"\s*/\*.*\*/$")


def braced(text: str) -> str:
    """Put braces around every body of an `if`, `else`, `for` and `while`.

    Args:
        text: C code in which bodies are on separate lines, indented more than their heads.
    """
    found: list[str] = []
    opened: list[int] = []  # indents of the heads whose bodies have an open brace
    balance = head = 0  # number of open parentheses, and the indent of the head to which they belong
    for line in text.split("\n"):
        indent = len(line) - len(line.lstrip())
        if balance == 0 and line.strip() and line[0] != "#":
            while opened and indent <= opened[-1]:
                found.append(f"{' ' * opened.pop()}}}")
            if line.lstrip().startswith("else") and found[-1] == f"{' ' * indent}}}":
                line = f"{found.pop()} {line.lstrip()}"
        if balance == 0:
            if not _HEAD.match(line):
                found.append(line)
                continue
            head = indent
        code = _COMMENT.sub("", line)
        balance += code.count("(") - code.count(")")
        if balance == 0 and code[-1] not in "{;":
            line = f"{code} {{{line[len(code) :]}"
            opened.append(head)
        found.append(line)
    return "\n".join(found)
