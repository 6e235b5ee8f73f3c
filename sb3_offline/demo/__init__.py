"""The demo: collect data, train, evaluate and report, with the functions of the other packages."""
