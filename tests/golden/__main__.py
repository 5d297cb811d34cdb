"""Write the golden rows anew: look at the difference before you commit it."""

from __future__ import annotations

from tests.golden import renew

if __name__ == "__main__":
    renew()
