"""Film of the page of `i2t view`, and the browser that looks at it (`tools.film.browser`)."""
