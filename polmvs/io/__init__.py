"""Images, arrays, clouds and other files, each fault a ``DataError``."""
