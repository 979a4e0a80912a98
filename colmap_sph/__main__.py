"""The program's entry: the command line, once it is loaded, which takes a second or so."""

import sys


def main() -> int:
    """Run the command line; an interruption while it loads ends without a traceback, too."""
    try:
        from colmap_sph import cli

        return cli.main()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
