"""Before there are images: boards to print, manifests, plans, and a guided capture."""
