"""From uniting equations of any origin to the united system: ``du = P dq + c`` and its linear solve."""
