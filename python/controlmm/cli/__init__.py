"""The command ``controlmm``: one thin file a subcommand."""
