"""The subcommands: the panel of the help each is in, its module, and its line in ``huddle --help``.

A module is imported when one of its commands is used, or asked for its help.
"""

from __future__ import annotations

PANELS: dict[str, dict[str, tuple[str, str]]] = {
    "Bench": {
        "init": ("setup", "Write a commented bench file to fill in."),
        "check": (
            "setup",
            "Validate a bench file, then identify every device and make the check list.",
        ),
        "plan": ("setup", "Compute the duration of recording for a target precision, by method."),
        "tui": ("acquisition", "Open the application: start, watch and stop a huddle test."),
        "run": ("acquisition", "Run one huddle test: record, estimate live, print the result."),
        "record": (
            "acquisition",
            "Record without estimating, until the duration has passed or Ctrl-C.",
        ),
        "watch": (
            "acquisition",
            "Show the live estimate of a recording that another process writes.",
        ),
    },
    "Unattended": {
        "serve": (
            "acquisition",
            "Run huddle tests on the schedule of the bench file, until Ctrl-C.",
        ),
        "status": (
            "service",
            "Show the state of the service of a bench: runs, sensors, disk, clock.",
        ),
        "runs": ("service", "List the runs of a service: state, verdict, recordings, reason."),
        "history": (
            "service",
            "Show the noise of every channel from run to run, and whether it has changed.",
        ),
        "pin": ("service", "Protect runs from removal by the storage limits of the bench file."),
        "verify": (
            "service",
            "Verify the checksums and signatures of recordings, or of all recordings of a service.",
        ),
        "sign": ("service", "Sign recordings with a private key, or make one."),
    },
    "Recordings": {
        "estimate": ("recordings", "Estimate the self-noise of every channel from recordings."),
        "calibrate": (
            "recordings",
            "Calibrate sensors against one of them by their common motion.",
        ),
        "archive": (
            "archives",
            "Keep the spectra of months of recordings, and show the noise over time.",
        ),
        "report": ("recordings", "Write the calibration report of a huddle test as HTML or PDF."),
        "issue": ("recordings", "Issue a numbered certificate of a huddle test as PDF."),
        "issues": (
            "recordings",
            "List the certificates of a ledger, with revisions and void numbers.",
        ),
        "plot": ("recordings", "Draw the self-noise of every channel as a figure for publication."),
        "import": ("recordings", "Convert files of other programs into a recording."),
        "export": ("recordings", "Write samples or noise curves for other programs."),
        "repair": (
            "recordings",
            "Verify the checksums of a recording, and close it if a crash left it open.",
        ),
    },
    "Without hardware": {
        "demo": ("setup", "Run a complete huddle test on simulated sensors."),
        "devices": ("setup", "Serve simulated devices of a bench file, until Ctrl-C."),
        "simulate": ("recordings", "Simulate a recording without devices."),
        "reproduce": (
            "studies",
            "Reproduce the figures of the paper and compare them with theory.",
        ),
    },
}
"""By panel and by name: the module in `tui.cli`, and the first line of the command's help."""

MODULES = {name: module for panel in PANELS.values() for name, (module, _) in panel.items()}
"""The module of each command."""
