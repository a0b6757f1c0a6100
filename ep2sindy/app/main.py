"""Entry point of the command line: `ep2sindy`, `python -m experiments.run`.

The current folder, which may be untrusted, is removed from the path before anything else is
imported.
"""

from __future__ import annotations

import sys

from ep2sindy.trust.user_code import leave_folder


def main() -> None:
    try:
        leave_folder()
    except ValueError as error:
        sys.exit(f"error: {error}")

    from ep2sindy.app.program import run

    run()


if __name__ == "__main__":
    main()
