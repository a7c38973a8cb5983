"""A program that answers messages by hand, and does what ranges below zero command."""

import json
import os
import struct
import sys
import time

HALF, PRINT, LEAVE, OTHER_SIZE, MUTE, FAIL, TWICE, SKIP, STATUS, FLAG = range(-1, -11, -1)
DESCRIPTION = {
    "summary": "does as it is told",
    "topics": [{"topic": "/range", "fields": ["range_m"]}],
    "state": {"range_m": "linear"},
    "failures": ["it was told to fail"],
    "protocol": 2,
}


def write(frame):
    os.write(1, struct.pack("<I", len(frame)) + frame)


write(b"D" + json.dumps(DESCRIPTION).encode())
while head := sys.stdin.buffer.read(4):
    frame = sys.stdin.buffer.read(struct.unpack("<I", head)[0])
    if frame[:1] == b"C":
        continue
    status, flags, numbers = 0, 0, b""
    if frame[:1] == b"T":
        _, _, wanted, value = struct.unpack("<iqBd", frame[5:])
        if value == HALF:
            os.write(1, struct.pack("<I", 22) + b"R....")
            sys.exit()
        if value == PRINT:
            print("hello from the filter", flush=True)
        if value == LEAVE:
            sys.exit("no more")
        if value == MUTE:
            time.sleep(60)
        status, flags = int(value == FAIL) - int(value == STATUS), wanted | 8 * (value == FLAG)
        numbers = struct.pack("<dd", value, 0.1)[: 8 if value == OTHER_SIZE else 16] if wanted else b""
        if value == SKIP:
            continue
    answer = b"R" + frame[1:5] + struct.pack("<iB", status, flags) + numbers
    write(answer)
    if frame[:1] == b"T" and value == TWICE:
        write(answer)
