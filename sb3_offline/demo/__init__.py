"""The main job end to end: collect, train, evaluate, report. Thin over the other rooms."""
