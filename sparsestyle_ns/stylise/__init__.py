"""`sparsestyle stylise`: the whole way from photos and a painting to pages, by the commands that one would type."""
