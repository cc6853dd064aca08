"""Programs on top of the library: the command line, web server, terminal monitor, Foxglove and network bridges."""
