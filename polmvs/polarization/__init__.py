"""From raw mosaics to Stokes images, regions and phase maps; the angle models."""
