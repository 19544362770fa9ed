"""The command line: a module a command, with the function that the library shares; numpy is imported when it runs."""
