"""``python -m tui`` is the ``huddle`` command."""

from tui.command import main

if __name__ == "__main__":
    main()
