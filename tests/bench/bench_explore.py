"""From a slider's event to changed curves on the page of `fuselog explore`, in headless Chromium.

Run it with `make bench`, or `python -m tests.bench explore`; without Chromium it has no rows.
"""

import shutil
import tempfile
from pathlib import Path
from statistics import median

import fuselog as fl

MOVES = 25
Row = tuple[str, str, str, str]
# The slider goes somewhere else; what it takes until NIS is drawn anew.
DRAG = """name => new Promise(done => {
  const page = Bokeh.documents[0], begin = performance.now();
  const curve = page.get_model_by_name("nis-line-0");
  const changed = () => {
    curve.properties.data.change.disconnect(changed);
    requestAnimationFrame(() => done(performance.now() - begin));
  };
  curve.properties.data.change.connect(changed);
  page.get_model_by_name(name).value = Math.random();
})"""


def main() -> list[Row]:
    """The median of moves of one slider of the robot's EKF and of the inertial one's."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        return []
    with tempfile.TemporaryDirectory() as folder:
        logs = [
            ("60 s of landmarks, robot's EKF", "landmarks", "sigma_range_m"),
            ("60 s of navigation, inertial EKF", "navigation", None),
        ]
        rows = []
        for what, scenario, name in logs:
            path = Path(folder) / f"{scenario}.mcap"
            fl.write(path, fl.record(scenario, duration_s=60.0))
            spent_ms = median(moves_ms(path, name, chromium))
            rows.append((f"explore, event to curves: {what}", f"{spent_ms:.0f} ms", "", ""))
    return rows


def moves_ms(path: Path, name: str | None, chromium: str) -> list[float]:
    """What each of `MOVES` takes, one after the other."""
    from playwright.sync_api import sync_playwright

    explorer = fl.explore(path, "ekf", show=False)
    name = name or explorer.session.sliders[0].name
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(explorer.url)
        page.wait_for_function("window.Bokeh && Bokeh.documents.length > 0")
        page.wait_for_timeout(2000)
        found = []
        for _ in range(MOVES):
            found.append(float(page.evaluate(DRAG, name)))
            page.wait_for_timeout(300)
        browser.close()
    explorer.close()
    return found


if __name__ == "__main__":
    for row in main():
        print(*row, sep=" | ")
