"""``python -m controlmm``: the command, where its script is not on the path."""

from controlmm.cli.main import main

if __name__ == "__main__":
    main()
