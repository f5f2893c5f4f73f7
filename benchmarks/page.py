"""How many pictures a second an exported page shows in headless Chromium, drawn by SwiftShader on the CPU.

    python benchmarks/page.py scene.html

The window has 400 × 300 pixels. While the flight plays, the page draws as many pixels as keep it quick, with a quarter
of the steps, and once it rests all of them.
"""

import sys
import tempfile
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from chromium import Tab, open_tab

WIDTH, HEIGHT = 400, 300
SECONDS = 5.0
FLY = """(async (seconds) => {
  const [frames, start, render] = [stage.frames, performance.now(), stage.render];
  let pixels = 0;
  stage.render = (camera, look, steps, width, height) => {
    pixels += width * height;
    return render(camera, look, steps, width, height);
  };
  stage.play();
  await new Promise((done) => setTimeout(done, 1000 * seconds));
  const drawn = stage.frames - frames;
  const found = [(1000 * drawn) / (performance.now() - start), pixels / drawn];
  stage.pause();
  stage.render = render;
  return found;
})(%g)"""


def frames_per_second(tab: Tab, page: Path, fixed: bool) -> tuple[float, float]:
    """Pictures a second while the flight plays, and their pixels, a mean; `fixed`: all the window's, all steps."""
    tab.open(page.resolve().as_uri() + (f"#size={WIDTH}x{HEIGHT}" if fixed else ""))
    tab.wait_for("document.body.dataset.state === 'ready'")
    return tuple(tab.evaluate(FLY % SECONDS))


def main() -> None:
    """Prints both figures of each page that is named."""
    for page in map(Path, sys.argv[1:]):
        profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        with profile as folder, open_tab(Path(folder), WIDTH, HEIGHT) as tab:
            quick, pixels = frames_per_second(tab, page, fixed=False)
            whole, _ = frames_per_second(tab, page, fixed=True)
        share = pixels / (WIDTH * HEIGHT)
        print(f"{page.name}: {quick:.1f} pictures a second of {share:.0%} of the pixels while the flight plays in a")
        print(f"  window of {WIDTH} × {HEIGHT}, {whole:.1f} a second with all of them and all steps")


if __name__ == "__main__":
    main()
