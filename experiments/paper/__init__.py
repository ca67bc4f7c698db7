"""The paper's figures and claims: what they are made of, what is said of them, how they are drawn."""
