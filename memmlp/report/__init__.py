"""Tables and figures for readers: an HTML page of a project, and pages of results kept with the code."""
