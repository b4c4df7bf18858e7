"""Drive a whole test on simulated devices and keep its screens: `make session`, some minutes.

`huddle devices` plays three sensors in processes of their own, with a fault script: a cable is
pulled and put back, and later a sensor is moved to another floor. `huddle tui` runs on a
pseudo-terminal and gets keys only. Its screens become docs/session.md. A step whose words do not
come to the screen ends the session with an error, and docs/session.md stays as it was.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.application import Terminal
from daq.python_process import python_command

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "session.md"
SIZE = (120, 36)
SPEED = 4.0
PORT = re.compile(r"/\w+/huddle-\w+/huddle-\w+/tty")
_KEY = re.compile(r"\x1b\[[A-D]|\x1b\[6~|.", re.DOTALL)
_FRAME = re.compile(rf"[|│━╌\u2800-\u28ff]+|{re.escape(tempfile.gettempdir())}\S*")
NAMES = {"\t": "tab", "\r": "enter", "\x1b": "esc", "\x1b[B": "↓", "\x1b[6~": "page down"}
QUESTIONS = """
## Twenty questions

Each with the keys that answer it, from the view before; seconds from the last key; the line that
answers.

| question | keys | s | answer |
|---|---|---:|---|
"""
PATIENCE = 400.0
"""Seconds until a step must have come to the screen."""
LIMIT = """
[[limits]]
name = "data sheet"
frequency = [2.0, 20.0]
psd = [3.6e-12, 3.6e-12]
"""
_WHITE = '{shape = "white", level = 2.0e-12}'
_HUM = '{shape = "resonance", level = 2e-9, frequency = 60.0, damping = 0.002}'
HUM = _WHITE, f'{{shape = "sum", terms = [{_WHITE}, {_HUM}]}}'
"""What B.X has for noise, and what it has here."""
FAULTS = """
[[faults]]
kind = "disconnect"
sensors = ["B"]
at = 150.0
duration = 40.0

[[faults]]
kind = "moved"
sensors = ["C"]
at = 700.0
duration = 1e6
"""
PREFACE = """\
# A session

A test on three simulated accelerometers, from the checks to the report. `make session` drives it:
`huddle devices` plays the sensors in processes of their own, `huddle tui` runs on a terminal of
120×36 and gets only the keys named here. During the first test a cable is pulled and put back;
before the second one ends, a sensor is moved to another floor. The screens are copied as they were.
A test compares titles, keys and columns with the application of today.
"""


class Session:
    """What a person does at a terminal, and the screens that were kept.

    Parameters
    ----------
    terminal : Terminal
    folder : Path
        Of the bench; its name is not for the page.
    """

    def __init__(self, terminal: Terminal, folder: Path) -> None:
        self._terminal, self._folder = terminal, str(folder)
        self.page, self.answers, self.n_keys, self.walk = PREFACE, "", 0, 0

    def see(self, *texts: str, without: str = "") -> None:
        """Wait until some texts are on the screen, and another one is not."""
        deadline = time.monotonic() + PATIENCE
        for text in texts:
            self._terminal.wait_for(text, timeout=deadline - time.monotonic())
        while without and any(without in row for row in self._terminal.rows):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{without!r} stayed on the screen")
            time.sleep(0.2)

    def press(self, *keys: str) -> None:
        """Press keys one after the other, as a person does."""
        for key in keys:
            self._terminal.press(key)
            self.n_keys += len(_KEY.findall(key))
            time.sleep(0.3)

    def ask(self, question: str, *keys: str, answer: str, without: str = "") -> str:
        """Press keys; keep the row of the answer, and the seconds that it took to come."""
        self.press(*keys)
        seconds = self._terminal.wait_for(answer, timeout=60)
        self.see(without=without)
        row = next(row for row in self._terminal.rows if answer in row)
        shown = " ".join(_FRAME.sub(" ", row.rpartition("▌")[2]).split())[:70]
        pressed = " ".join(NAMES.get(key, key) for each in keys for key in _KEY.findall(each))
        self.answers += f"| {question} | {pressed or '–'} | {seconds:.1f} | {shown} |\n"
        print(self.answers.splitlines()[-1], flush=True)
        return row

    def keep(self, title: str, text: str) -> None:
        """Keep the screen, once it has come to rest."""
        time.sleep(1.5)
        home = "/home/lab"
        rows = [row.replace(self._folder, home) for row in self._terminal.rows]
        rows = [PORT.sub("…/tty", row).rstrip() for row in rows]
        screen = "\n".join(rows).rstrip("\n")
        self.page += f"\n## {title}\n\n{text}\n\n```text\n{screen}\n```\n"
        print(f"{title}\n{screen}\n", flush=True)


@contextmanager
def simulated(folder: Path) -> Iterator[Path]:
    """Play the devices of the demo's bench; yields a bench file that reaches them."""
    demo = (ROOT / "tui" / "resources" / "demo.toml").read_text(encoding="utf-8")
    bench, faults, reachable = (folder / f"{n}.toml" for n in ("demo", "faults", "lab"))
    demo = demo.replace('name = "demo"', 'name = "lab"', 1).replace(*HUM, 1)
    bench.write_text(demo + LIMIT, encoding="utf-8")
    faults.write_text(FAULTS, encoding="utf-8")
    command = python_command("tui", "devices", str(bench), "--speed", str(SPEED))
    command += ["--faults", str(faults), "--out", str(reachable)]
    with subprocess.Popen(command, cwd=folder) as devices:
        try:
            while not reachable.exists():
                if devices.poll() is not None:
                    raise RuntimeError("the simulated devices did not start")
                time.sleep(0.2)
            yield reachable
        finally:
            devices.terminate()


def drive(session: Session) -> None:
    """Do the whole test."""
    session.see("p checks the sensors")
    session.ask("Is anything wrong before the test?", "p", answer="nothing wrong is seen")
    session.ask("Are all sensors sending?", answer="● live")
    session.keep(
        "Before the test",
        "`p` reads the sensors without recording. The last line says that all is ready.",
    )
    session.press("s")
    session.see("start a test")
    session.press("\t", "after transport", "\t", "\x7f" * 8, "decided")
    session.press("\r")
    session.see("power spectral density", "c.o.v.", "● recording")
    session.keep("The test runs", "The first curves, and a verdict that is not decided yet.")
    session.ask("How long must I still record?", answer="Record for")
    session.ask("Are the clocks good enough?", answer="clocks A")
    session.see("disconnected")
    session.ask("Which sensor is lost, and since when?", answer="B has been disconnected")
    session.keep("A cable is pulled", "The recorder goes on with the other two sensors.")
    session.see("● live", without="disconnected")
    session.see("Least margin")
    session.keep(
        "Decided", "The test has ended by itself. The Result view opens, with margin and interval."
    )
    result_view(session)
    signal_view(session)
    session.press("3")
    session.see("Least margin")
    session.ask("Make the report.", "w", answer="Report written")
    session.ask("Make a specimen of the certificate.", "i", "\r", answer="Specimen made")
    session.press("s")
    session.see("start a test")
    session.press("\t", "\t", "\x7f" * 8, "\r")
    session.see("● recording", "C records none of the motion")
    session.keep(
        "A sensor on another floor",
        "The next test, without an end. Somebody carries sensor C away: the alert names it.",
    )
    session.press("x", "y")
    session.see("channel    data", "w Report")
    session.ask("Which tests are there?", "4", answer="▸ 20")
    session.ask(
        "How does this compare with the test before?", "\x1b[B", "c", answer="compared with"
    )


def result_view(session: Session) -> None:
    """Ask what a result answers."""
    session.walk = session.n_keys + 2
    session.ask("Is it good, and what next?", answer="✓ PASS")
    session.ask("Which limit is nearest?", answer="Least margin")
    session.ask("How noisy is A.X, and how sure is that?", answer="A.X  ")
    session.ask("Has A become noisier over its tests?", answer="A S")
    session.ask("Whose samples are missing?", answer="B: 1 gap")
    session.ask("Do the sensors share one motion?", answer="model test passes")
    session.ask("Are all upright?", "a", answer="lean")
    session.ask("How coherent are A and B?", "\x1b[6~", answer="Coherence of pairs")
    session.press("\x1b")


def signal_view(session: Session) -> None:
    """Ask what a waveform answers."""
    session.press("5")
    session.see("C.Z", "UTC")
    row = session.ask("What happened to B's cable, and when?", "n", "n", "n", answer="B gap")
    at = row.split()[0][:5]
    session.ask(f"What happened at {at}?", "t", at, "\r", answer=" to ")
    session.ask("When was it loud?", "g", answer="recorded", without="drawing")
    session.ask("When was the noise loud?", "g", answer="noise", without="drawing")
    session.ask(
        "Which sensor hums?", "\x1b[B", "\x1b[B", "\x1b[B", answer="B.X noise", without="drawing"
    )
    session.ask("Leave this out.", "g", "x", ">", "x", answer="excluded (x: take it back)")
    session.ask("Is it left out?", "3", answer="by choice of the time")
    session.press("5")
    session.see("x Exclude")
    session.ask("Take it back.", "x", answer=" B.X ", without="take it back")


def test_before(folder: Path) -> None:
    """Do a short test of the same sensors, for a ledger of its own."""
    os.environ["HUDDLE_SENSORS"] = str(folder / "sensors.sqlite")
    earlier = folder / "earlier"
    earlier.mkdir()
    with simulated(earlier) as bench:
        test = python_command("tui", "run", str(bench), "--duration", "4min")
        subprocess.run(test, cwd=earlier, stdout=subprocess.DEVNULL, check=False)


def main() -> None:
    """Drive the session; write the page."""
    with tempfile.TemporaryDirectory(prefix="lab-") as name:
        folder = Path(name)
        test_before(folder)
        with simulated(folder) as bench:
            terminal = Terminal(bench, SIZE, None)
            session = Session(terminal, folder)
            try:
                drive(session)
            finally:
                session.press("\x1b", "2", "x", "y")  # no recorder stays behind a failed session
                time.sleep(3)
                terminal.close()
    walk = f"\nFrom the first key to the specimen of the certificate: {session.walk} keys.\n"
    PAGE.write_text(session.page + QUESTIONS + session.answers + walk, encoding="utf-8")


if __name__ == "__main__":
    main()
