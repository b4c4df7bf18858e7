"""``python -m tui`` is the ``huddle`` command."""

from tui.commands.main import main

if __name__ == "__main__":
    main()
