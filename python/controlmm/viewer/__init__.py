"""Pictures of motion: a one-page contact sheet (``.png``) and moving figures (``.gif``, ``.mp4``).

``Motion.save`` finds them by suffix; options go through it by name: ``motion.save("walk.png", frames=12)``,
``motion.save("walk.mp4", follow=True, progress=True)``. Targets are drawn when the motion carries them
(``motion.extra["targets"]``, ``motion.extra["mask"]``) or when they are passed.
"""
