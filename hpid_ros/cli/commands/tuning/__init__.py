"""The subcommands that choose and judge gains."""
