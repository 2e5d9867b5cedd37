"""``python -m rille``: the command line."""

from rille.pipeline.cli import main

if __name__ == "__main__":
    main()
