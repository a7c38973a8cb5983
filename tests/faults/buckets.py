"""Logs in a bucket: moto's stand-in for S3 on loopback, what goes wrong there, and killed copies.

It needs the extra `buckets`, which brings many packages; without it, nothing is tried.
"""

import contextlib
import io
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from fuselog.pipeline.command_line import main
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import make_stream, open_log, schemas, write_log
from fuselog.recorders.remote import backends
from fuselog.recorders.remote.paths import located, partly
from tests.faults import Tally

FUSELOG = str(Path(sys.executable).with_name("fuselog"))
SECRET = "wJalrXUtnFEMI"


@dataclass(frozen=True)
class Bucket:
    """A bucket with `large.mcap`; the same log is in the current folder."""

    client: Any

    def put(self, name: str, content: bytes) -> str:
        """Store an object; its URL."""
        self.client.put_object(Bucket="drives", Key=name, Body=content)
        return f"s3://drives/{name}"


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Try each of the trials in turn, for so long or so many times."""
    try:
        import moto.server
        import s3fs  # noqa: F401
    except ModuleNotFoundError:
        return Tally(0, 0, ["not tried: pip install 'fuselog[buckets]'"])
    end = time.monotonic() + seconds
    tried, notes = 0, []
    with (
        tempfile.TemporaryDirectory(prefix="fuselog-buckets-") as name,
        contextlib.chdir(name),
        _serving(moto.server.ThreadedMotoServer) as bucket,
    ):
        while time.monotonic() < end and tried != most:
            trial = TRIALS[tried % len(TRIALS)]
            shutil.rmtree("cache", ignore_errors=True)
            size = int(rng.integers(100_000, 600_000))
            values = rng.standard_normal(size)
            stamps = np.arange(size) * 10**7
            log = make_stream("/range", schemas.RANGE, stamps, target_id=0 * values, range_m=values)
            write_log("large.mcap", [log])
            wrong = trial(bucket, bucket.put("day/large.mcap", Path("large.mcap").read_bytes()), rng)
            notes += [f"{trial.__name__.strip('_')}: {wrong}"] if wrong else []
            tried += 1
    return Tally(tried, tried - len(notes), notes)


@contextlib.contextmanager
def _serving(make: Callable[..., Any]) -> Iterator[Bucket]:
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # it prints every request
    server = make(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        address = "http://{}:{}".format(*server.get_host_and_port())
        variables = {
            "AWS_ENDPOINT_URL": address,
            "AWS_ACCESS_KEY_ID": "user",
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_DEFAULT_REGION": "us-east-1",
            "FUSELOG_CACHE": str(Path("cache").absolute()),
        }
        with mock.patch.dict(os.environ, variables), mock.patch.object(backends, "PAUSES_S", (0.1,)):
            import boto3

            client = boto3.client("s3")
            client.create_bucket(Bucket="drives")
            yield Bucket(client)
    finally:
        server.stop()


def _whole(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    """A copy has the bytes of the object; a new object replaces it."""
    if located(url).read_bytes() != Path("large.mcap").read_bytes():
        return "the copy differs"
    other = rng.bytes(1000)
    return "" if located(bucket.put("day/large.mcap", other)).read_bytes() == other else "an old copy"


def _summary(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    """Opening by ranges fetches at most 2 %, and finds what the whole log has."""
    fetched, read = [], backends.RangeFile.read

    def counted(file: backends.RangeFile, offset: int, length: int) -> bytes:
        fetched.append(length)
        return read(file, offset, length)

    with mock.patch.object(backends.RangeFile, "read", counted):
        found = open_log(partly(located(url))).topics
    if found != open_log("large.mcap").topics:
        return "other topics"
    share = sum(fetched) / Path("large.mcap").stat().st_size
    return "" if 0 < share <= 0.02 else f"fetched {share:.1%}"


def _folder(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    found = [str(each) for each in located("s3://drives/day/").glob("*.mcap")]
    return "" if found == [url] else f"listed {found}"


def _absent(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    return _said("not found", "s3://drives/no.mcap") or _said("not found", "s3://nobody/large.mcap")


def _refused(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    from moto import settings

    with mock.patch.object(settings, "INITIAL_NO_AUTH_ACTION_COUNT", 0.0):  # it knows no user
        return _said("access refused", url)


def _changed(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    """An object that is replaced between two readings, or while it is copied, is not mixed."""
    log = located(url)
    assert log.identity
    content = Path("large.mcap").read_bytes()
    bucket.put("day/large.mcap", content[:-1] + b"!")
    try:
        log.read_bytes()
    except BadInput as error:
        return "" if "changed while it was read" in str(error) else str(error)
    return "two versions were mixed"


def _killed(bucket: Bucket, url: str, rng: np.random.Generator) -> str:
    """A command that is killed while it copies leaves nothing that a later one would use or keep."""
    process = subprocess.Popen([FUSELOG, "lint", url], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    end = time.monotonic() + 60
    while not list(Path("cache/remote").glob(".*.part")) and time.monotonic() < end:
        if process.poll() is not None:
            break
        time.sleep(0.001)
    time.sleep(float(rng.uniform(0, 0.2)))
    process.kill()
    process.communicate()
    if located(url).read_bytes() != Path("large.mcap").read_bytes():
        return "the copy differs"
    left = [each.name for each in Path("cache/remote").iterdir() if each.suffix != ".mcap"]
    return f"left {left}" if [each for each in left if each.endswith(".part")] else ""


def _said(sentence: str, url: str) -> str:
    """What is wrong with the sentence in which `info` and `lint` fail."""
    for command in ("info", "lint"):
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([command, url])
        text = err.getvalue()
        if code != 2 or text.count("\n") != 1 or f"{url}: {sentence}" not in text or SECRET in text:
            return f"{command}: code {code}, {text!r}"
    return ""


TRIALS = (_whole, _summary, _folder, _absent, _refused, _changed, _killed)
