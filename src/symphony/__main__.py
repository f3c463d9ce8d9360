"""``python -m symphony`` is the ``symphony`` command."""

from symphony.cli import main

raise SystemExit(main())
