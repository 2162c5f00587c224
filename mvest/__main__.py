"""The console command ``mvest``, and ``python -m mvest``."""

import sys
from pathlib import Path


def main() -> int:
    """Run the command line; returns the exit status."""
    # Find the package experiments that was installed with this one.
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from experiments.cli import main as command

    return command()


if __name__ == "__main__":
    sys.exit(main())
