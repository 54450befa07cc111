"""Dense volumes of files as sparse ones, and back: geokit/formats/images has the formats."""
