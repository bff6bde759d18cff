"""The paper's claims on systems whose causes are known: what would refute them, and how often."""
