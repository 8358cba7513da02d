"""Images, arrays, clouds and other files; a faulty file is a ``DataError``."""
