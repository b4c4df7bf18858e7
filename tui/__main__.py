"""``python -m tui`` is the ``huddle`` command."""

from tui.cli.main import main

if __name__ == "__main__":
    main()
