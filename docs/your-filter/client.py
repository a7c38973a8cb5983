"""A filter served to fuselog over standard input and output: `serve(DESCRIPTION, Filter)`.

A filter is a class with these methods: `__init__(parameters, seed)`, `start(time_ns, mean, covariance)`
(None and None if the log has no prior), `take(topic, time_ns, fields)`, `predict(time_ns)`, and
`state()`, which returns mean and covariance, or None. `take` returns None, or the innovation, its
covariance and whether it was used. If a method raises Failed(n), the run ends with the n-th sentence of
`failures`.
"""

import json
import os
import struct
import sys
from array import array


class Failed(Exception):
    """A failure: the number of its sentence in `failures`, counted from 1."""


def serve(description, make):
    """Answer frames until standard input ends; prints are redirected to standard error."""
    given, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    state = list(description["state"].values())
    n, t = len(state), len(state) - state.count("quaternion") // 4 - state.count("axis") // 2

    def write(frame):
        answers.write(struct.pack("<I", len(frame)) + frame)
        answers.flush()

    def numbers(frame, at):
        return array("d", frame[at:]).tolist()  # for little-endian machines, as nearly all are

    write(b"D" + json.dumps({**description, "protocol": 2}).encode())
    own = None
    while head := given.read(4):
        frame = given.read(struct.unpack("<I", head)[0])
        kind, status, flags, told, wanted = frame[:1], 0, 0, [], False
        try:
            if kind == b"C":
                (seed,) = struct.unpack_from("<Q", frame, 1)
                own = make(numbers(frame, 9), seed)
                continue
            if kind == b"S":
                time_ns, has_prior = struct.unpack_from("<qB", frame, 5)
                prior = numbers(frame, 14) if has_prior else []
                square = [prior[n + t * i : n + t * i + t] for i in range(t)]
                own.start(time_ns, *((prior[:n], square) if has_prior else (None, None)))
            elif kind == b"T":
                topic, time_ns, wanted = struct.unpack_from("<iqB", frame, 5)
                innovation = own.take(topic, time_ns, numbers(frame, 18))
            elif kind == b"P":
                own.predict(struct.unpack_from("<q", frame, 5)[0])
                wanted = True
            if wanted and (said := own.state()) is not None:
                flags, told = 1, [*said[0], *(x for row in said[1] for x in row)]
            if kind == b"T" and innovation is not None:
                flags |= 2 | 4 * (not innovation[2])
                told += [*innovation[0], *(x for row in innovation[1] for x in row)]
        except Failed as failed:
            status, flags, told = failed.args[0], 0, []
        head = b"R" + frame[1:5] + struct.pack("<iB", status, flags)  # the number of the answered frame
        write(head + array("d", map(float, told)).tobytes())
