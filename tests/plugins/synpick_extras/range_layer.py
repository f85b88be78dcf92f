"""Layer of the distance between camera and surface, along the ray; the kernel is a file of its own, since writers import this one."""


class LAYER:
    """Distance of the surface from the camera's centre."""

    dtype, components, unit, encoding = "uint16", 1, "mm", "raw"
    values = "Distance of the surface point from the camera's centre [mm]; 0: no surface."
    note = "distance from the camera's centre in millimetres; 0: no surface."
    kernel = "synpick_extras.range_kernel:render_range_kernel"
