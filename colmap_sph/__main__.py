"""The program's entry: the command line, once it is loaded, which takes a second or so."""

import os
import sys


def main() -> int:
    """Run the command line; an interruption while it loads ends without a traceback, too."""
    try:
        from colmap_sph.app import cli

        return cli.main()
    except BrokenPipeError:  # whoever reads the output has closed it, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
