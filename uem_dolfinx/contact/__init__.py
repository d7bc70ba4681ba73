"""From surfaces to uniting equations: declaration, couplings, active set, what is read from a contact."""
