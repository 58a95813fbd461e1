"""The potential energy of a displacement, elastic and of contact, with its derivatives."""
