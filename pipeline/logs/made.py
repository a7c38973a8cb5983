"""Descriptions of timelines and result folders, for `fuselog info`."""

from collections import Counter
from pathlib import Path
from shlex import quote

from fuselog.pipeline.output.report.kinds import run_sentences
from fuselog.pipeline.output.results import RESULT_FILE, Result, read_result
from fuselog.pipeline.output.terminal import print_json, print_others, print_table, print_worst, say
from fuselog.recorders.errors import BadInput


def show_result(folder: Path, *, as_json: bool) -> None:
    """Print the content of a result folder: what was run, the outcome, and its files."""
    result = read_result(folder)
    if as_json:
        print_json({"path": str(folder), **result.model_dump(mode="json")})
        return
    ran, came = run_sentences(result, folder)
    say(f"{folder}: a result of {_what(result)}, fuselog {result.fuselog}: {ran}")
    print_worst(result.alarms)
    say(came)
    print_others(result.alarms)
    counts = Counter(Path(name).parts[0] for name in result.files)
    rows = [[name, count] for name, count in counts.items() if name != RESULT_FILE]
    print_table(["content", "files"], rows)
    shown = [f"fuselog report {quote(str(folder))}"]
    if (folder / "timeline.rrd").is_file() or "sweep" in result.settings:
        shown.append(f"fuselog view {quote(str(folder))}")
    say(f"To view it: {', '.join(shown)}; to process it further: fuselog compare, check")


def _what(result: Result) -> str:
    title = result.settings.get("title")
    return f"{result.experiment} ({title})" if title else result.experiment


def show_timeline(path: Path, *, as_json: bool) -> None:
    """Print the entities of a timeline, each with its number of rows.

    Raises BadInput if the timeline cannot be read.
    """
    from rerun.chunk import RrdReader  # slow to import

    try:
        reader = RrdReader(str(path))
        names = sorted({each.application_id for each in reader.recordings()})
        rows: Counter[str] = Counter()
        for chunk in reader.stream():
            if not chunk.entity_path.startswith("/__"):
                rows[chunk.entity_path] += chunk.num_rows
    except Exception as error:  # rerun does not document its exceptions
        raise BadInput(f"{path}: cannot be read as a timeline ({error}); save it again") from error
    entities = dict(sorted(rows.items()))
    if as_json:
        print_json({"path": str(path), "timeline": names, "entities": entities})
        return
    say(f"{path}: {path.stat().st_size / 1e6:.1f} MB, a timeline of {', '.join(names) or 'nothing'}")
    print_table(["entity", "rows"], list(entities.items()))
    say(f"To view it: fuselog view {quote(str(path))}")
