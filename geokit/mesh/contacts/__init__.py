"""Where two surfaces touch, are near or cross, and how far one may move before they do."""
