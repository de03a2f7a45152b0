"""The `genassets` command: one file a command, registered in `app`."""
