"""``python -m symphony.cli`` is the ``symphony`` command."""

from symphony.cli import main

raise SystemExit(main())
