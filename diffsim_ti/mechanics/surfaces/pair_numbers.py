"""Which numbers of the scene the pairs of a list have, on the host."""

from types import SimpleNamespace

import numpy as np

from diffsim_ti.mechanics.surfaces.buffers import whole
from diffsim_ti.terms.self_contact import SelfContact


class PairNumbers:
    """Of SurfacePairs: places of numbers among the scene's parameters."""

    def __init__(self, pairs):
        self.pairs, self.kinematic, self.contacts = pairs, pairs.kinematic, pairs.contacts
        mesh, term, index = pairs.mesh, pairs.term, SelfContact.index
        first = pairs.a.parameters_of_self_contact.start
        self.label, self.row_of = np.zeros(mesh.num_vertices, int), np.full((1, 1), -1)
        if term and term.has_friction:
            self.label[mesh.surface_vertices], self.row_of = term.labels(mesh)
        self.first_mu = first + index.friction
        self.rows = np.array([[first + index.stiffness, first + index.width, first + index.friction_speed]])
        if not (term and term.has_friction):
            self.rows[0, 2] = 0
        if self.contacts:
            self.rows = self.contacts.rows

    def of(self, pairs: np.ndarray, corners: np.ndarray) -> SimpleNamespace:
        """Of pairs of the list by number, and their corners: contact (obstacle_corners.py), the area that its stiffness is
        multiplied by, and where stiffness, width, friction speed and coefficient stand, -1 without friction."""
        row = self.row_of[self.label[corners[:, 0]], self.label[corners[:, 2]]]
        mu, contact = np.where(row >= 0, self.first_mu + row, -1), np.zeros(len(corners), int)
        area = np.ones(len(corners))
        if self.kinematic:
            contact = self.kinematic.numbers[corners[:, [0, 2]]].max(1)
            area = whole(self.pairs.list.area)[pairs].astype(float)
            of_contacts = np.append(
                -1, np.where(self.contacts.row_of < 0, -1, np.append(self.contacts.mu, -1)[self.contacts.row_of])
            )
            mu = np.where(contact > 0, of_contacts[contact], mu)
        stiffness, width, speed = self.rows[contact].T
        return SimpleNamespace(contact=contact, area=area, stiffness=stiffness, width=width, speed=speed, mu=mu)
