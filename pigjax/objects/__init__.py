"""Objects of a scene: lifting of masks, association across views, editing, evaluation, overlays."""
