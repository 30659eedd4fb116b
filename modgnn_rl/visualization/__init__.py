"""Drawing of recorded rollouts: replay page, images, videos, live viewer. Nothing here depends on the task."""
