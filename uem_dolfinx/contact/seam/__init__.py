"""The interface between a contact pair and its discretisation, and the states of contactors."""
