"""`python -m jaxlocmap`, and the command `jaxlocmap`."""

import sys


def main() -> None:
    """Run the job that the command line names."""
    try:
        from jaxlocmap.cli import main as cli
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("jaxlocmap"):
            raise
        sys.exit(f"error: {error.name} is not installed: expected pip install 'jaxlocmap[cli]'")
    cli.main()


if __name__ == "__main__":
    main()
