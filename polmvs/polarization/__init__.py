"""Raw mosaics to Stokes images, regions and phase maps, and what each angle model makes of them."""
