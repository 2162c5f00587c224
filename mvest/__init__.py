"""Patient-specific mitral leaflet stiffness, estimated from how the valve is seen to move.

Data flows one way, and the packages are its stations: `imaging` turns volumes into a `valve`,
`mechanics` moves the valve under pressure, `estimation` finds the parameters whose motion is the
observed one, and `reporting` turns estimates into tables and figures. `model` and `study` join
them.

Inside the library lengths are mm, times s, masses tonne, forces N and stresses MPa.
"""

__version__ = "0.1.0"
