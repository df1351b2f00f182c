"""What a qualification decides and records, without any drive: steps, checks, claims, record, signature, summary."""
