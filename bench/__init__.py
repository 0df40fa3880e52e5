"""How it is compared: suites, the runner, scores, tables, figures and the command line."""
