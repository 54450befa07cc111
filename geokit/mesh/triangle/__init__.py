"""One triangle and a point, a ray or another triangle: answers that keep their digits."""
