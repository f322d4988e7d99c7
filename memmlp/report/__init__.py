"""Tables and figures for readers: an HTML page of a project, and pages of kept results."""
