"""``python -m sim_devices SPEC.json``; see :mod:`sim_devices.server.serve`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from sim_devices.errors import SimulationError
from sim_devices.server.launch import start


def main(arguments: list[str]) -> int:
    """Serve every device of a specification until standard input is closed."""
    if len(arguments) != 1:
        print("usage: python -m sim_devices SPEC.json", file=sys.stderr)
        return 2
    try:
        spec = json.loads(Path(arguments[0]).read_text(encoding="utf-8"))
        with start(spec) as running:
            for device in running:
                keys = ("sensors", "driver", "port", "settings")
                print(json.dumps({key: getattr(device, key) for key in keys}), flush=True)
            sys.stdin.read()
    except KeyboardInterrupt:
        return 130
    except (OSError, SimulationError) as error:
        print(error, file=sys.stderr)
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
