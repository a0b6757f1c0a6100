"""Where the command line begins: `ep2sindy`, `python -m experiments.run`.

Nothing else is imported before the current folder, which may be anybody's, is off the path.
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
